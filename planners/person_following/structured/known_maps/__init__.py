"""Where maps show several goals: maps remembered from experience, what persons head for and believe."""
