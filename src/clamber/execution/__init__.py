"""Trajectory -> physics -> verdict."""
