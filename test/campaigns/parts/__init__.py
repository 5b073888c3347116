"""What the campaigns are made of."""
