"""A pipeline of three small stages behind the real command line, for tests of the orchestration."""
