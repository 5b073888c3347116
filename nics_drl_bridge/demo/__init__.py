"""The demo: the whole road once, from a recording to a learned policy that drives over ROS 2."""
