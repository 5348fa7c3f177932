"""What runs say of themselves, as plain values and as tables: progress, cost, agreement."""
