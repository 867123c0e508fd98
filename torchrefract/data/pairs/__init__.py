"""Pairs written to disk: sources, making and writing, in processes and shards, with a card that tells of them."""
