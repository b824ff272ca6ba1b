"""Implement the commands of the command line, one module per command. torch is loaded only when it is needed."""
