"""ELAN: ``reading`` reads tiers, ``times`` gives their annotations times, ``writing`` puts tiers into a file."""
