"""The ROS 2 node and the bag player: wiring between messages and the core, no mathematics."""
