"""The robot, the camera and the cable in software: to rehearse without any of them."""
