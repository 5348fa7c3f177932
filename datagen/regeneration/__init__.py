"""Shards and scenes made again from their records: for resumed jobs, checks, repairs and replays."""
