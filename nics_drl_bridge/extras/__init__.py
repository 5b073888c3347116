"""What needs an optional library or serves few; reached by entry points only."""
