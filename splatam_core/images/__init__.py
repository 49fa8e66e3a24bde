"""Images as the stages see them: views, filters, rectification."""
