"""One script per table or figure, run as ``python -m experiments.<name>``; recordings are read from the folder DYNTORCH_DATA."""
