"""The thesis, checked: what it states, chapter by chapter, beside what is measured on data made from its own definitions."""
