"""Stage `ingest`: recordings in, cleaned frames out."""
