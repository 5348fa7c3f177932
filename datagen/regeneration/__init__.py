"""Make shards and scenes again from their records, for checks, repairs and replays."""
