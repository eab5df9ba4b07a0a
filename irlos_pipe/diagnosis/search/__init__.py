"""The search for missing effects: families of effects, score tests, candidates."""
