"""Reports of all diagnoses: findings, a verdict, their text, figures and files."""
