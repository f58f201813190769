"""Text and drawing primitives: markup, small drawings, the style of figures, page templates."""
