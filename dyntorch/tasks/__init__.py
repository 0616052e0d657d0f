"""The tasks a person comes with: each a verb that returns a frozen result."""
