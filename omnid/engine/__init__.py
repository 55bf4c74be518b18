"""Threads, clocks, queues and process settings; nothing about robots."""
