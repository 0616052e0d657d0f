"""Recognition of actions: tables beside baselines, on clip sets and in recordings."""
