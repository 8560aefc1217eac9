"""A recorded stack brought to the model's unit: checked, flattened and scaled."""
