"""Pipeline stages and the command line."""
