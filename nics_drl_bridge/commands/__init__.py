"""Commands of `nics`; each imports its libraries only when it runs, so that others start fast."""
