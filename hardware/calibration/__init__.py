"""What links a robot, a camera and a table, and how it is computed from measurements."""
