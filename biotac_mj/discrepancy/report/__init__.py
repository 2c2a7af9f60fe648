"""What a diagnosis says, whichever program made it: findings, a verdict, their text, figures and files."""
