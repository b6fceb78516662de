"""Students: policies that learn a teacher's actions by what they feel, many of them in one simulation."""
