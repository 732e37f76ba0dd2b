"""Import of ROS bags: a robot's own recording becomes one of ours. The page is docs/BAGS.md."""
