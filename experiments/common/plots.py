"""What the pictures of results have in common."""

COLOURS = ("#0b4a60", "#e07b39", "#6aa84f", "#8e5ea2", "#b3123a", "#59636d")
MARKS = ("o", "s", "^", "D", "v", "P")
