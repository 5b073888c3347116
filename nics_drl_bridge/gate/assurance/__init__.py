"""Evidence for a gate: episodes that try to make it fail, driven by a protocol fixed beforehand."""
