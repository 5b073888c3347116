"""Tools that need an optional library or few people use; loaded only by entry points."""
