"""The experiments behind the defaults, which are not shipped; results/ has what they found."""
