"""What the model answers about one person: condition on their photographs once, then render them under any light."""
