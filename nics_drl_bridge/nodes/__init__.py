"""ROS 2 nodes: thin wrappers around the simulator, the middleware and the policies."""
