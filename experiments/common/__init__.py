"""What experiments share: reproducible books of results, tables, plots, real data."""
