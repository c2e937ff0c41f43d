"""Many runs: climbs, sweeps, statistics."""
