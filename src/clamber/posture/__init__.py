"""Stance and demonstrated posture -> stable posture."""
