"""Labels that people make: how long it takes to find the rest of an hour, and which labels help most."""
