"""Commands of `nics`, one module each."""
