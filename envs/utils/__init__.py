"""Utilities shared by all packages: files, JSON, validation."""
