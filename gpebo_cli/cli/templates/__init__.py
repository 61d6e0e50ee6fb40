"""What ``gpebo new`` writes: files that pass as they stand, with ``mine`` and ``Mine`` as names."""
