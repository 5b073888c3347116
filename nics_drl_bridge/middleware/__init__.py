"""What stands between a robot's topics and whoever asks for its view. Knows no ROS."""
