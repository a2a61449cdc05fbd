"""Many runs: sequences x settings x seeds from one plan, one process each."""
