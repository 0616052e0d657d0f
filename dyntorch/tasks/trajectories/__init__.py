"""triangulate_trajectories, trajectory_cameras: points on straight lines, seen one view at a time."""
