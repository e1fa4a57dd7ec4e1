"""Trains what the paper's figures show and draws them again: `make reproduce`."""
