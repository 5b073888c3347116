"""Calibration: what a real recording needs before a fit, and the fit of real recordings.

`identify` goes the whole way from a recording to a model.
"""
