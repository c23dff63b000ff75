"""Scripts, one for each question, and what they share (`support`); see README.md here."""
