"""A person's motion -> contact sequence."""
