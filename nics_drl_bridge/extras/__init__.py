"""Tools that need an optional library or serve few; reached by entry points only."""
