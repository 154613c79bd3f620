"""Checked histories: clients and faults against real servers, and what the answers must have been."""
