"""Which contacts, when: search, proposals, timing -> plan."""
