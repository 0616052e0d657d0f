"""Tensors and alignment: noise, outliers, real data."""
