"""The online replanner: a new trajectory from a new pose within milliseconds, never late, never invalid."""
