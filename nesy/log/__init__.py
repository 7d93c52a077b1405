"""Experience: transitions in columns, collected in resumable shards."""
