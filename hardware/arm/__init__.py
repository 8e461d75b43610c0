"""One arm: the robot's protocol, its kinematics, its limits, and the safety layer before it."""
