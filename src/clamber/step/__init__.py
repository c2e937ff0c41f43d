"""One contact change: statics, postures, transition, path."""
