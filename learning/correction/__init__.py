"""Corrected episodes: a policy acts, and a teacher labels every state that it comes to."""
