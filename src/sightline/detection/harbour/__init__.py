"""The detector that ships with the package; ``MODEL_CARD.md`` beside it says what it can do."""
