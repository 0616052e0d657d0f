"""The tasks a person comes with: a room for each verb, which returns a frozen result; what results share is in ``outcome``."""
