"""Carry out what the command line asks: one module a command; torch loads where it is needed."""
