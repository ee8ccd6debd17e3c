"""What a person has after taking photos and drawing masks: raw trees, masks in many forms, foreign layouts."""
