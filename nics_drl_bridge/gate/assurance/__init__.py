"""Evidence for a gate: episodes that try to make it fail, by a predefined protocol."""
