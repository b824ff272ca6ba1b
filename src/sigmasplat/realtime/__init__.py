"""SLAM on two clocks: tracking at the rate of the camera, and the work on the map beside it."""
