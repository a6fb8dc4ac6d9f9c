"""What robots recorded: ROS 1 bags, ROS 2 bags and MCAP, read without ROS (docs/logs.md)."""
