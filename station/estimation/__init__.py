"""Estimation: a rig's parameters from runs, by prediction errors over several horizons.

Data (``dataset``) and a hypothesis' parameters (``parameters``) give predictions (``prediction``, with the observers of
``observer``); ``least_squares`` fits them, ``likelihood`` says what the errors are worth, ``identifiability`` what the
runs determine.
"""
