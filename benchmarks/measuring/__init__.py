"""What several benchmarks need: scenes, rates, and environments for other projects."""
