"""Evaluation of policies: episodes, statistics, comparisons, tables and reports."""
