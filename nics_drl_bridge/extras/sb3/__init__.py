"""What needs PyTorch: training with Stable-Baselines3, and the export of torch modules."""
