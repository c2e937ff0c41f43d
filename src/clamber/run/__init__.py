"""A run on disk, and for other people's tools."""
