"""The shipped tasks, each for one robot or a team."""
