"""LeRobot in its own environment, which the tests run as another process."""
