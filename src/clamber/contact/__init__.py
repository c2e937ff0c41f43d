"""Contacts, stances, sequences, steps, policies: what touches what, and when."""
