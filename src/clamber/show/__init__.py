"""To look at: pictures, plots, the report, the live view."""
