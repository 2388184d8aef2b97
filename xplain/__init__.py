"""Personalized explanations of sequential decisions (Soni, Sreedharan & Kambhampati, 2021)."""

__version__ = "0.1.0"
