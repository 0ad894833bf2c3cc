"""Campaigns: many cases diagnosed over many cores or machines, and what they say together."""
