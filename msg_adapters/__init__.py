"""Converts ROS messages to numpy and back: pure functions, no rclpy, no SLAM."""
