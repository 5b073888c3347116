"""ROS 2 nodes: thin coats around the simulator, the middleware and the policies."""
