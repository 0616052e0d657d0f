"""Synchronization of cameras: tables on synthetic and real recordings."""
