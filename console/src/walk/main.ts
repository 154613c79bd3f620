import { mount } from 'svelte';
import '../app.css';
import '../lib/theme.svelte';
import Walk from './Walk.svelte';

mount(Walk, { target: document.getElementById('app')! });
