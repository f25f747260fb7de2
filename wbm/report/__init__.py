"""Statistics, plots, videos, the report page and the viewer."""
