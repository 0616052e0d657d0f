"""Long recordings: windows at many durations, the best explanation as segments, events, counts, people; live, too."""
