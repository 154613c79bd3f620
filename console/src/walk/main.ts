import { mount } from 'svelte';
import '../app.css';
import '../lib/theme.svelte';
import { keepPage } from './offline';
import Walk from './Walk.svelte';

mount(Walk, { target: document.getElementById('app')! });
// Without a network the page was kept before.
addEventListener('load', () => void keepPage().catch(() => undefined));
