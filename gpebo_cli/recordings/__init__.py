"""Signals that were measured elsewhere: tables of samples, and what they mean between samples."""
