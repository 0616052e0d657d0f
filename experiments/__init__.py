"""One script per table or figure; each reads the folder named by ``DYNTORCH_DATA`` and runs with ``python -m experiments.<name>``."""
