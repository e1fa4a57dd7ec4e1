"""The learner's inner loops in C, and how they are compiled on the machine they run on."""
