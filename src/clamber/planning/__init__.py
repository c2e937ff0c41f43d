"""Contact planning and timing: search, proposals, trajectory -> plan."""
