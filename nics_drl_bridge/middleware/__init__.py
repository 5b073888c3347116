"""The middleware between a robot's topics and the users of its view. Independent of ROS."""
