"""Stereo matching of two panoramas along their columns, and triangulation."""
