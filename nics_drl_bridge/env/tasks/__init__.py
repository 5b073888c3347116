"""The tasks that are shipped, one robot or a team each."""
