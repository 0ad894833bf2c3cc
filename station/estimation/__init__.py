"""Estimation: a rig's parameters from runs, by prediction errors over two horizons.

Data (``dataset``) and a hypothesis' parameters (``parameters``) give predictions (``prediction``, with the observers of
``observer``; ``responses``, of frequency responses); ``least_squares`` fits them, ``constants`` a rig's constants,
``likelihood`` says what the errors are worth, ``identifiability`` what the runs determine.
"""
