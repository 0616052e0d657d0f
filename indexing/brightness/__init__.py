"""Video without tracks: actions recognized from image gradients alone (thesis, chapter 7; after Irani)."""
