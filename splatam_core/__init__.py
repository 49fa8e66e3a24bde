"""SplaTAM in Python: dense RGB-D SLAM on 3D Gaussians, without ROS."""
