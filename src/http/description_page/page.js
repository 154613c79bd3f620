// Swagger UI without what the checks of accessibility refuse: links inside of buttons, a level of headings that is left out, and
// colours of examples that are too faint.
const accessible = ({ React }) => ({
  wrapComponents: {
    DeepLink: () => ({ text }) => React.createElement('span', null, text),
    InfoContainer: (Information) => (props) =>
      React.createElement(React.Fragment, null, React.createElement(Information, props), React.createElement('h2', { className: 'wrapper' }, 'Operations')),
  },
});

SwaggerUIBundle({
  dom_id: '#description',
  url: '/openapi.json',
  // It would ask a server on the internet whether the description is well formed.
  validatorUrl: 'none',
  layout: 'BaseLayout',
  syntaxHighlight: { activated: false },
  presets: [SwaggerUIBundle.presets.apis],
  plugins: [accessible],
});
