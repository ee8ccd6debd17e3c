"""Alignment, metrics, protocols, the GIFT-I evaluation and its tables, and prediction for single images."""
