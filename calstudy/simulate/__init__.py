"""Visibilities of skies: the engines that compute them, and what limits their accuracy."""
