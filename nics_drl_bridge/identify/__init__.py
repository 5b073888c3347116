"""From a recording to a model: calibration, fit (Eq. 1), pruning (Eq. 2), and a verdict."""
