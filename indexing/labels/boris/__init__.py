"""BORIS: ``project`` reads projects and ``writing`` writes them, ``tables`` reads the two kinds of tables that BORIS exports."""
