"""The ROS 2 node and the bag player. They connect messages to the core."""
