"""The learner's inner loops and the policy in C, and how they are compiled on the machine they run on."""
