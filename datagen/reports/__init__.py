"""Reports on runs as plain values and as tables: progress, cost, agreement."""
