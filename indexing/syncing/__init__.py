"""What stands between a user's recordings and :func:`indexing.synchronize`: takes, people, lenses, videos, shifted files."""
