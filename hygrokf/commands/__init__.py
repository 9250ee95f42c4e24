"""The command line: one function of the package for each command."""
