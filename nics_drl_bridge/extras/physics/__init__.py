"""What robots on wheels with contact have in common, whichever physics engine moves them."""
